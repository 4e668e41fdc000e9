"""The BAM by hand: paper sections II-B to II-D, misprints mended, in plain numpy.

Independent of the package: nothing is imported from it. Angles rad, lengths m, q = (yaw, pitch,
extension) along the last axis.
"""

import numpy as np

L, G, DESIGN_MASS, N = 0.461, 9.81, 3.56, 5.0
I_G, I_HS, I_S10, I_T = 28.8e-3, 4.313e-3, 15.52e-3, 187e-3
I_ROD = 1e-3 * np.array([[821, -0.801, 0.783], [-0.801, 826, 0.052], [0.783, 0.052, 10.25]])
DRIVE = I_HS + I_S10 * N**2


def attitude(q):
    """A = R_y(yaw) R_x(-pitch): rod axes to base axes, (3, 3)."""
    (s, c), (sp, cp) = (np.sin(q[0]), np.cos(q[0])), (np.sin(q[1]), np.cos(q[1]))
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    about_x = np.array([[1, 0, 0], [0, cp, sp], [0, -sp, cp]])
    return about_y @ about_x


def position(q, shift=L):
    """Point on the rod ``shift`` before the grip: eq 6 for ``L``, the grip itself for 0; (3,)."""
    d = q[2] - shift
    return d * np.array([np.cos(q[1]) * np.sin(q[0]), np.sin(q[1]), np.cos(q[1]) * np.cos(q[0])])


def jacobian(q, shift=L):
    """d position / d q, (3, 3), by hand."""
    (s, c), (sp, cp), d = (np.sin(q[0]), np.cos(q[0])), (np.sin(q[1]), np.cos(q[1])), q[2] - shift
    return np.array(
        [[d * cp * c, -d * sp * s, cp * s], [0.0, d * cp, sp], [-d * cp * s, -d * sp * c, cp * c]]
    )


def mass_matrix(q, mass):
    """Mass matrix (eq 13) worked out by hand, (3, 3)."""
    s, c, rho = np.sin(q[1]), np.cos(q[1]), q[2] - L
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = I_ROD
    yaw = mass * rho**2 * c**2 + yy * c**2 + zz * s**2 + 2 * yz * s * c + I_T + DRIVE
    pitch = mass * rho**2 + xx + I_G + DRIVE
    cross = -xy * c - xz * s
    return np.array([[yaw, cross, 0.0], [cross, pitch, 0.0], [0.0, 0.0, mass]])


def bias(q, qd, mass):
    """Coriolis, centrifugal and gravity terms by hand, (3,): M qdd + bias = Q."""
    s, c, rho = np.sin(q[1]), np.cos(q[1]), q[2] - L
    (_, xy, xz), (_, yy, yz), (_, _, zz) = I_ROD
    a, b, v = qd
    slope = -2 * mass * rho**2 * s * c + 2 * (zz - yy) * s * c + 2 * yz * (c**2 - s**2)
    return np.array(
        [
            slope * a * b + 2 * mass * rho * c**2 * v * a + (xy * s - xz * c) * b**2,
            2 * mass * rho * v * b - slope * a**2 / 2 + mass * G * rho * c,
            -mass * rho * (c**2 * a**2 + b**2) + mass * G * s,
        ]
    )


def compensator(q, carriage_ratio=4.0, height=0.11, gearing=2.7, reel=0.03, preload=160.0):
    """Pitch torque of the gravity compensator, eqs 15 and 16 letter by letter, N.m."""
    spring = DESIGN_MASS * G * carriage_ratio / (height * gearing**2)
    carriage = (q[2] - L) / carriage_ratio
    cable = np.sqrt(carriage**2 + height**2 - 2 * carriage * height * np.sin(q[1]))
    rest = reel * preload / (spring * gearing)
    tension = (reel * preload + spring * (cable - rest) * gearing) * gearing
    return tension * height * carriage * np.cos(q[1]) / cable


def user_torque(q, force):
    """J^T A f of a force in rod axes at the grip (eq 19), (3,)."""
    return jacobian(q, shift=0.0).T @ attitude(q) @ force
