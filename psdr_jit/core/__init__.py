"""Ground floor: what knows Dr.Jit and Mitsuba, but no scene. AD, random numbers, records, films, sensors."""
