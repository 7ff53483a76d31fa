"""A rigid motion in numbers that people compare: micrometres, pixels and degrees."""

import numpy as np

from clra.methods.alignment.result import AlignmentResult
from clra.model.rigid.rigid_motion import RigidMotion


def rigid_parts(result: AlignmentResult) -> dict[str, tuple[float, float, float]]:
    """Sum up a rigid motion: root mean square, largest and standard error of its six parts.

    Parameters
    ----------
    result : AlignmentResult
        Of the alignment.

    Returns
    -------
    dict of str to (float, float, float)
        By part and unit, translations in micrometres at the sample and in pixels of the detector;
        nothing where the motion is no rigid one. Standard errors are root mean squares over the
        valid views, NaN where a part was not estimated.
    """
    motion = result.motion
    if not isinstance(motion, RigidMotion):
        return {}
    near, per_u, per_v = motion.optics[:, :3].T
    sigma = np.full((motion.views, 6), np.nan)
    sigma[:, : result.sigma.shape[1]] = result.sigma
    um = 1e3 * near[:, None]
    moved = {
        "along u [\u00b5m]": (1e3 * motion.translation[:, 0], sigma[:, 0] * um[:, 0] / per_u),
        "along v [\u00b5m]": (1e3 * motion.translation[:, 1], sigma[:, 1] * um[:, 0] / per_v),
        "along the beam [\u00b5m]": (1e3 * motion.translation[:, 2], sigma[:, 2] * um[:, 0]),
        "along u [pixel]": (motion.translation[:, 0] * per_u / near, sigma[:, 0]),
        "along v [pixel]": (motion.translation[:, 1] * per_v / near, sigma[:, 1]),
    }
    for k, axis in enumerate(("u", "v", "the beam")):
        name = f"about {axis} [degree]"
        moved[name] = np.degrees(motion.rotation[:, k]), np.degrees(sigma[:, 3 + k])
    valid = result.valid_views
    return {
        name: (
            float(np.sqrt(np.mean(values[valid] ** 2))),
            float(np.abs(values[valid]).max()),
            float(np.sqrt(np.mean(error[valid] ** 2))),
        )
        for name, (values, error) in moved.items()
    }
