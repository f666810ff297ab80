"""Light paths: how they scatter, the one walk that traces them, and what it records."""
