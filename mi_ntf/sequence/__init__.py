"""Many frames of one scene: what changes from frame to frame, and rendering it in one process or in shards of many."""
