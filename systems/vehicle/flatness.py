"""Differential flatness of the quadrotor: from a wanted acceleration to thrust and body rates.

A quadrotor's position and yaw determine its attitude: the specific thrust must supply the wanted
acceleration, carry the weight and overcome drag, so its direction is the body z axis, and yaw
fixes the rest (D. Mellinger and V. Kumar, "Minimum snap trajectory generation and control for
quadrotors", ICRA 2011; with drag: M. Faessler, A. Franchi and D. Scaramuzza, "Differential flatness
of quadrotor dynamics subject to rotor drag", RA-L 2018). The attitude is then reached by turning
the body z axis along the shortest way first and yaw at leisure, since only the former moves the
vehicle (D. Brescianini and R. D'Andrea, "Tilt-prioritized quadrocopter attitude control", T-CST
2018).

Frames: W world, B body, D the desired body. Vectors are numpy arrays of shape (3,). Thrust is over
mass [m/s^2], angles in rad.
"""

import math

import numpy as np

_TINY = 1e-9  # Below this length a unit vector's direction is meaningless.


def reaching_acceleration(
    p_WR: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, lookahead: float
) -> np.ndarray:
    """The constant acceleration [m/s^2] that takes the vehicle to p_WR [m] in ``lookahead`` [s].

    a = 2 (p_WR - p_WB - T v_WB) / T². Applied continually with p_WR(t) = r(t + T), it makes p_WB
    follow r with the transfer function e^x / (1 + x + x²/2), x = sT: an error of third order in T,
    damped at 1/√2. A lag of T/3 between wanted and actual acceleration removes the third order too.
    """
    return 2.0 * (p_WR - p_WB - lookahead * v_WB) / lookahead**2


def thrust_for_acceleration(
    a_WB: np.ndarray, v_WB: np.ndarray, drag: float, gravity: float
) -> np.ndarray:
    """The specific thrust in W [m/s^2] under which the vehicle accelerates with a_WB.

    f = a_WB + g e_z + drag v_WB, the translational dynamics solved for the thrust.
    """
    f_W = a_WB + drag * v_WB
    f_W[2] += gravity
    return f_W


def limit_thrust(
    f_W: np.ndarray, min_thrust: float, max_thrust: float, max_tilt: float
) -> np.ndarray:
    """``f_W`` brought within ``max_tilt`` [rad] of vertical and the thrust range [m/s^2].

    The vertical part is kept and the horizontal part shortened to respect the tilt; only then is
    the whole shortened to ``max_thrust``. A vertical part below ``min_thrust``, pointing down for
    instance, becomes ``min_thrust``.
    """
    fx, fy, fz = f_W.tolist()
    fz = max(fz, min_thrust)
    horizontal = math.hypot(fx, fy)
    widest = fz * math.tan(max_tilt)
    if horizontal > widest:
        fx, fy = fx * widest / horizontal, fy * widest / horizontal
    shrink = min(1.0, max_thrust / max(math.hypot(fx, fy, fz), _TINY))
    return np.array([shrink * fx, shrink * fy, shrink * fz])


def attitude_from_thrust(f_W: np.ndarray, yaw: float) -> np.ndarray:
    """R_WD (3, 3): body z along ``f_W``, and body x pointing where ``yaw`` [rad] says.

    Seen from above, body x points exactly along ``yaw``: it is perpendicular to the horizontal
    left-hand direction. Where that is undefined, in a body rolled by 90 deg, it comes closest to
    the heading. Zero thrust gives the level attitude.
    """
    norm = math.sqrt(f_W.dot(f_W))
    z_W = f_W / norm if norm > _TINY else np.array([0.0, 0.0, 1.0])
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    zx, zy, zz = z_W.tolist()

    x_W = np.array([cos_yaw * zz, sin_yaw * zz, -sin_yaw * zy - cos_yaw * zx])  # left × z
    length = math.sqrt(x_W.dot(x_W))
    if length > 1e-3:
        x_W = x_W / math.copysign(length, zz)
    else:
        y_W = np.array([-zz * sin_yaw, zz * cos_yaw, zx * sin_yaw - zy * cos_yaw])  # z × heading
        x_W = cross(y_W / math.sqrt(y_W.dot(y_W)), z_W)
    return np.column_stack((x_W, cross(z_W, x_W), z_W))


def heading_along_motion(motion_W: np.ndarray, full_speed: float) -> tuple[float, float]:
    """Returns the heading [rad] of a motion (3,) [m/s] and how far to turn to it, from 0 to 1.

    The fraction falls as the square of the horizontal speed below `full_speed` [m/s], so that a
    hovering vehicle does not turn after noise.
    """
    fraction = min(1.0, math.hypot(motion_W[0], motion_W[1]) / full_speed)
    return math.atan2(motion_W[1], motion_W[0]), fraction**2


def attitude_error(R_WB: np.ndarray, R_WD: np.ndarray) -> tuple[np.ndarray, float]:
    """The turn from B to D as ``(tilt_B (2,), yaw)`` [rad].

    First the body turns by |tilt_B| about the axis tilt_B in its own x-y plane, the shortest turn
    that brings its z axis to D's; then by ``yaw`` about that z axis. With z_B opposite to z_D,
    where every axis is as short, it turns about body x.
    """
    R_BD = R_WB.T @ R_WD
    (x1, _, z1), (x2, _, z2), (x3, _, z3) = R_BD.tolist()
    sine = math.hypot(z1, z2)
    angle = math.atan2(sine, z3)
    n1, n2 = (-z2 / sine, z1 / sine) if sine > _TINY else (1.0, 0.0)

    # D's x axis seen from the tilted body: e_x and e_y turned about n, against column x of R_BD.
    cosine, sine = math.cos(angle), math.sin(angle)
    along = (n1 * x1 + n2 * x2) * (1.0 - cosine)
    ahead = cosine * x1 - sine * n2 * x3 + along * n1
    left = cosine * x2 + sine * n1 * x3 + along * n2
    return np.array([angle * n1, angle * n2]), math.atan2(left, ahead)


def limit_norm(vector: np.ndarray, limit: float) -> np.ndarray:
    """``vector`` (n,), shortened to length ``limit`` if it is longer."""
    norm = math.sqrt(vector.dot(vector))
    return vector * (limit / norm) if norm > limit else vector


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b, (3,) each; np.cross costs twenty times as much on single vectors."""
    a1, a2, a3 = a.tolist()
    b1, b2, b3 = b.tolist()
    return np.array([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1])
