"""From a call to its images: the table of terms, the pilot that measures their noise, and the plan they follow."""
