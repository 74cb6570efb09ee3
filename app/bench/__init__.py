"""Bench: what a step costs, pass by pass, and what live control costs."""
