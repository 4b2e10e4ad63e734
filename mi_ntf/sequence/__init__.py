"""Many frames of one scene: what changes between them, and rendering them in one process or in several."""
