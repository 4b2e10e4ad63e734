"""``mi-ntf tradeoff``: the error of a scene's picture over the seconds that it takes, by every way to render the scene.
Begin with :mod:`mi_ntf.evaluate.tradeoff.study`."""
