"""Before anything runs: a working LLVM for Dr.Jit, found, probed or fetched. Imports neither drjit nor mitsuba."""
