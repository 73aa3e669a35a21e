"""Reports and plots of recordings, figures, maps, fits, plans and forecasts."""
