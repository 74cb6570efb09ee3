"""View: recordings and live views in Rerun."""
