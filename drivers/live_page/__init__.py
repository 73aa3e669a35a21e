"""A page in the browser that follows a recording."""
