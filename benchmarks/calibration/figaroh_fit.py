"""FIGAROH's calibration of one data set; run by the Python that has FIGAROH, nothing else needed.

``python figaroh_fit.py FOLDER``: reads robot.urdf, figaroh.yaml and train.csv there, held_out.csv
to verify, and prints one line of JSON.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from pathlib import Path
from typing import Any


def main(folder: Path) -> dict[str, Any]:
    """Return the held-out rms (m, of one coordinate), seconds of CPU and what was fitted."""
    import numpy as np
    from figaroh.calibration.base_calibration import BaseCalibration  # type: ignore[import-not-found]
    from figaroh.calibration.calibration_tools import calc_updated_fkm  # type: ignore[import-not-found]
    from figaroh.tools.robot import Robot  # type: ignore[import-not-found]

    class Calibration(BaseCalibration):  # type: ignore[misc]
        """The library's own calibration, with its own residuals."""

        def cost_function(self, var: Any) -> Any:
            """Return measured minus predicted."""
            predicted = calc_updated_fkm(
                self.model, self.data, var, self.q_measured, self.calib_config
            )
            return self.PEE_measured - predicted

    logging.disable(logging.WARNING)
    robot = Robot(str(folder / "robot.urdf"), package_dirs=str(folder))
    begun = time.process_time()
    fit = Calibration(robot, str(folder / "figaroh.yaml"))
    # the instrument stands anywhere and the target sits anywhere on the flange; no key says so
    fit.calib_config |= {"known_baseframe": False, "known_tipframe": False}
    softness = [n for n in fit.calib_config["param_name"] if n.startswith("k_")]
    fit.initialize()
    # the base frame takes the names of the first six parameters (1.0.2): put back what it took
    known = fit.calib_config["param_name"]
    known += [name for name in softness if name not in known]
    result = fit.solve(enable_logging=False)
    seconds = time.process_time() - begun
    values = fit.LM_result.x if result is None or not hasattr(result, "x") else result.x
    away = fit.calib_config | {"NbSample": len(fit._q_val)}
    predicted = calc_updated_fkm(fit.model, fit.data, values, fit._q_val, away)
    left = np.asarray(fit._PEE_val) - predicted
    return {
        "held_out_rms": float(np.sqrt(np.mean(left**2))),
        "seconds": seconds,
        "parameters": len(fit.calib_config["param_name"]),
        "names": list(fit.calib_config["param_name"]),
    }


if __name__ == "__main__":
    print("RESULT " + json.dumps(main(Path(sys.argv[1]))))
