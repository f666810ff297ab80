"""Scene files shipped as package data; locate them with `importlib.resources.files("psdr_jit.scenes")`."""
