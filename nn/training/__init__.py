"""Training: networks made from recorded runs; the only place of torch."""
