"""The field in Dr.Jit: networks, baked grid, marching, visibility. Works on whichever back end the caller's arrays
have.

Everything here is in *field coordinates* (the object inside the unit sphere at the origin) unless a name says
``world``.
"""
