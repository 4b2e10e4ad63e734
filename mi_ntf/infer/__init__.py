"""The field in Dr.Jit: networks, baked grid, marching, visibility, on the back end of the caller's arrays.

Everything here is in *field coordinates* (the object inside the unit sphere at the origin) unless a name says
``world``.
"""
