"""Contents of a scene file: camera, fields, shapes, settings, and the effects that they need."""
