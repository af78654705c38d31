"""Hedges to hop over, a rangefinder, and a policy that hops."""
