"""The `psdr` command: a file for each subcommand."""
