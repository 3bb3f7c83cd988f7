"""Two configurations over one recording, with a plot: what does the lever arm do?

The second configuration forgets where the antenna sits. The plot shows horizontal standard deviation and innovations.
Needs matplotlib: ``pip install matplotlib``.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib import pyplot as plt

import eskf_ros

CHECKOUT = Path(__file__).resolve().parent.parent


def main(picture: Path) -> dict[str, eskf_ros.Result]:
    """Run the filter twice, write the plot and print how well the fixes agree with each of them."""
    given = eskf_ros.load_parameters(CHECKOUT / "config" / "tunnel_drive.yaml")
    without = dataclasses.replace(given, gnss=dataclasses.replace(given.gnss, lever_arm=(0.0, 0.0, 0.0)))
    tables = eskf_ros.read_bag(CHECKOUT / "bags" / "tunnel_drive.mcap", given)
    results = {
        name: eskf_ros.run(**tables, parameters=parameters, output_rate=10.0)
        for name, parameters in (("lever arm as measured", given), ("lever arm forgotten", without))
    }
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(9, 6), layout="constrained")
    for name, result in results.items():
        rows = result.odometry
        seconds = (rows["stamp"] - rows["stamp"][0]) * 1e-9
        variance = rows["pose_covariance"][:, 0, 0] + rows["pose_covariance"][:, 1, 1]
        above.semilogy(seconds, np.sqrt(np.where(rows["position_known"], variance, np.nan)), label=name)
        innovations = result.innovations
        is_fix = np.asarray(innovations["aid"] == "gnss_position")
        stamps, nis = np.asarray(innovations["stamp"])[is_fix], np.asarray(innovations["nis"])[is_fix]
        below.plot((stamps - rows["stamp"][0]) * 1e-9, nis, ".", markersize=3, label=name)
        print(f"{name}: mean NIS of the fixes {np.nanmean(nis):.2f} (3 where the model is true)")
        for warning in result.warnings:
            print(f"  {warning}")
    above.set(ylabel="horizontal standard deviation (m)")
    below.set(xlabel="time (s)", ylabel="NIS of the fixes", yscale="log")
    above.legend()
    figure.savefig(picture, dpi=120)
    plt.close(figure)
    print(f"plot: {picture}")
    return results


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("compare_configurations.png"))
