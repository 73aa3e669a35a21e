"""A page in the browser that shows a growing recording."""
