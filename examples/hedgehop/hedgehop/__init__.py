"""A world with hedges, a rangefinder, a policy that climbs over them, and a capture format."""
