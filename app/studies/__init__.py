"""Studies: methods measured against each other, cost against error, and what advice follows."""
