"""Quadrics fitted to the neighbourhood of a point: curvatures, their directions, distance to the surface."""
