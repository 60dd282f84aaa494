"""Clouds on surfaces whose normals and curvatures are known by formula."""

import numpy as np


def sphere(count, radius, rng, noise_mm=0.0):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals + rng.normal(0.0, noise_mm, (count, 1)) * normals, normals


def cylinder(count, radius, height, rng, noise_mm=0.0):
    angle = rng.uniform(0, 2 * np.pi, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    axis = np.column_stack([np.zeros((count, 2)), rng.uniform(-height / 2, height / 2, count)])
    return (radius + rng.normal(0.0, noise_mm, (count, 1))) * normals + axis, normals


def tilted_plane(count, side, rng, noise_mm=0.0):
    turn, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))
    flat = np.column_stack([rng.uniform(0, side, (count, 2)), rng.normal(0.0, noise_mm, count)])
    return flat @ turn, np.tile(turn[2], (count, 1))


def angle_deg(a, b):
    """Angles between lines, in degrees."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.abs((a * b).sum(axis=1))))


def rms_deg(a, b):
    return float(np.sqrt(np.mean(angle_deg(a, b) ** 2)))
