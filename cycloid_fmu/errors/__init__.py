"""Manufacturing and assembly errors of a drive."""
