"""The bivariate quadratic z = a + bx + cy + dx² + exy + fy² over a fitted plane; knows how to fit one, at one point."""

import math

import numpy as np
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import Int64Array
from scanner_service.analysis.plane import smallest_axis

COEFFICIENTS = 6
_PIVOT = 1e-10


@njit(cache=True, nogil=True, error_model="numpy")
def frame_at(points: Float64Array, row: int, rows: Int64Array, frame: Float64Array) -> bool:
    """Put the axes u, v, n of the plane fitted to `rows` into `frame` (3, 3); False when there is no plane."""
    x = y = z = xx = xy = xz = yy = yz = zz = 0.0
    px, py, pz = points[row, 0], points[row, 1], points[row, 2]
    for k in range(len(rows)):
        dx, dy, dz = points[rows[k], 0] - px, points[rows[k], 1] - py, points[rows[k], 2] - pz
        x, y, z = x + dx, y + dy, z + dz
        xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
        yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
    per = 1.0 / len(rows)
    nx, ny, nz, large, middle, _ = smallest_axis(
        xx - x * x * per, xy - x * y * per, xz - x * z * per, yy - y * y * per, yz - y * z * per, zz - z * z * per
    )
    if not middle > 1e-9 * large:
        return False
    # u lies across the normal and the coordinate axis that is least along it
    if abs(nx) <= abs(ny) and abs(nx) <= abs(nz):
        ux, uy, uz = 0.0, nz, -ny
    elif abs(ny) <= abs(nz):
        ux, uy, uz = -nz, 0.0, nx
    else:
        ux, uy, uz = ny, -nx, 0.0
    per = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux * per, uy * per, uz * per
    frame[0, 0], frame[0, 1], frame[0, 2] = ux, uy, uz
    frame[1, 0], frame[1, 1], frame[1, 2] = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    frame[2, 0], frame[2, 1], frame[2, 2] = nx, ny, nz
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def fit_bivariate(
    points: Float64Array,
    row: int,
    rows: Int64Array,
    radius: float,
    frame: Float64Array,
    coefficients: Float64Array,
    variances: Float64Array,
) -> float:
    """Least squares of the heights of `rows` over the plane of `frame`, seen from the point `row`.

    Puts a ... f into `coefficients` (6,), in units of mm, 1 and 1/mm, and their variances over the residual's into
    `variances` (6,). Returns the residual per degree of freedom in mm (0 without any), or NaN when the points do not
    determine the coefficients.
    """
    normal = np.zeros((6, 6))
    right = np.zeros(6)
    height_sq = 0.0
    term = np.empty(6)
    term[0] = 1.0
    per = 1.0 / radius
    for k in range(len(rows)):
        dx = (points[rows[k], 0] - points[row, 0]) * per
        dy = (points[rows[k], 1] - points[row, 1]) * per
        dz = (points[rows[k], 2] - points[row, 2]) * per
        x = dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]
        y = dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]
        z = dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2]
        term[1], term[2], term[3], term[4], term[5] = x, y, x * x, x * y, y * y
        for i in range(6):
            right[i] += term[i] * z
            for j in range(i + 1):
                normal[i, j] += term[i] * term[j]
        height_sq += z * z
    # Cholesky factor in the lower triangle
    for i in range(6):
        for j in range(i + 1):
            value = normal[i, j]
            for k in range(j):
                value -= normal[i, k] * normal[j, k]
            if i == j:
                if not value > _PIVOT * normal[i, i]:
                    return np.nan
                normal[i, i] = math.sqrt(value)
            else:
                normal[i, j] = value / normal[j, j]
    explained = 0.0
    for i in range(6):
        value = right[i]
        for k in range(i):
            value -= normal[i, k] * coefficients[k]
        coefficients[i] = value / normal[i, i]
        explained += coefficients[i] * coefficients[i]
    for i in range(5, -1, -1):
        value = coefficients[i]
        for k in range(i + 1, 6):
            value -= normal[k, i] * coefficients[k]
        coefficients[i] = value / normal[i, i]
    # diagonal of the inverse: columns of the factor's inverse, squared and summed
    for i in range(6):
        variances[i] = 0.0
        for j in range(6):
            term[j] = 0.0
        for j in range(i, 6):
            value = 1.0 if j == i else 0.0
            for k in range(i, j):
                value -= normal[j, k] * term[k]
            term[j] = value / normal[j, j]
            variances[i] += term[j] * term[j]
    freedom = len(rows) - 6
    residual = radius * math.sqrt(max(height_sq - explained, 0.0) / freedom) if freedom > 0 else 0.0
    coefficients[0] *= radius
    for i in range(3, 6):
        coefficients[i] *= per
    variances[0] *= 1.0
    for i in range(1, 3):
        variances[i] *= per * per
    for i in range(3, 6):
        variances[i] *= per**4
    return residual


@njit(cache=True, nogil=True, error_model="numpy")
def foot_of_origin(coefficients: Float64Array, reach: float) -> tuple[float, float]:
    """Where (x, y) the surface comes nearest to the origin, by damped Newton steps within `reach`."""
    a, b, c, d, e, f = coefficients
    x = y = 0.0
    for _ in range(20):
        z = a + b * x + c * y + d * x * x + e * x * y + f * y * y
        zx, zy = b + 2.0 * d * x + e * y, c + e * x + 2.0 * f * y
        gx, gy = x + z * zx, y + z * zy
        hxx, hxy, hyy = 1.0 + zx * zx + 2.0 * d * z, zx * zy + e * z, 1.0 + zy * zy + 2.0 * f * z
        if not (hxx > 0.0 and hxx * hyy - hxy * hxy > 0.0):  # beyond the centre of curvature: descend instead
            hxx, hxy, hyy = 1.0 + zx * zx, zx * zy, 1.0 + zy * zy
        per = 1.0 / (hxx * hyy - hxy * hxy)
        sx, sy = per * (hyy * gx - hxy * gy), per * (hxx * gy - hxy * gx)
        x, y = x - sx, y - sy
        if x * x + y * y > reach * reach:
            return 0.0, 0.0
        if abs(sx) + abs(sy) <= 1e-12 * reach:
            break
    return x, y


@njit(cache=True, nogil=True, error_model="numpy")
def curvatures_at(coefficients: Float64Array, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Principal curvatures k1 >= k2 at (x, y) and their directions over the plane, (x1, y1) and (x2, y2).

    From the two fundamental forms; positive where the surface bends towards +z.
    """
    _, b, c, d, e, f = coefficients
    zx, zy = b + 2.0 * d * x + e * y, c + e * x + 2.0 * f * y
    ee, ff, gg = 1.0 + zx * zx, zx * zy, 1.0 + zy * zy
    w = math.sqrt(ee + zy * zy)
    ll, mm, nn = 2.0 * d / w, e / w, 2.0 * f / w
    area = ee * gg - ff * ff
    mean = 0.5 * (ee * nn - 2.0 * ff * mm + gg * ll) / area
    gauss = (ll * nn - mm * mm) / area
    root = math.sqrt(max(mean * mean - gauss, 0.0))
    k1, k2 = mean + root, mean - root
    # (II - k1 I) (x1, y1) = 0; of its two rows the longer one decides
    p, q, s = ll - k1 * ee, mm - k1 * ff, nn - k1 * gg
    if p * p + q * q >= q * q + s * s:
        x1, y1 = -q, p
    else:
        x1, y1 = -s, q
    if x1 == 0.0 and y1 == 0.0:
        x1 = 1.0
    # the other direction is across it in the metric of the surface
    x2, y2 = -(ff * x1 + gg * y1), ee * x1 + ff * y1
    return k1, k2, x1, y1, x2, y2
