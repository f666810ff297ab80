"""Scene files of scenes as they are now: see `write.write_scene`."""
