"""The study of `mi-ntf tradeoff`: error over seconds of a scene's picture, for every way to render it.

It begins in :mod:`mi_ntf.evaluate.tradeoff.study`.
"""
