"""``mi-ntf tradeoff``: what accuracy costs, on one scene: seconds, memory and error of the visibility methods and their
dials, as a page to look at. Begin with :mod:`mi_ntf.evaluate.tradeoff.study`."""
