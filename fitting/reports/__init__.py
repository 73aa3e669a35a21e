"""Reports and plots of recordings, figures, fits and plans."""
