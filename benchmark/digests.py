"""Digests of what the estimator gives: a change of structure leaves all of them as they are.

    python benchmark/digests.py [--compare FILE] [--save FILE]

Each case is a recording through `eskf_replay` at IMU rate, looked at from outside only: odometry with its covariance,
the record of every measurement, and the final state, unrounded. The cases: the bundled recording, a simulated drive
with every sensor (two receivers, magnetometer, constraints), ranges in mode tight, and KITTI (a real drive; needs
gtsam) with late fixes and outages. `--save` keeps the digests; `--compare` exits with 1 and names the cases in which
one differs. They are those of one machine and one set of libraries: elsewhere compilers round differently.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from eskf_ros.replay.main import main as replay  # noqa: E402
from eskf_ros.simulate.main import main as simulate  # noqa: E402
from support.recordings.kitti import kitti_recording  # noqa: E402

INSTALLATION = """\
/**:
  ros__parameters:
    gnss.lever_arm: [0.8, -0.2, 1.4]
    second_gnss.frame_id: gps2
    second_gnss.lever_arm: [-0.8, 0.2, 1.4]
    mag.use: true
    nhc.enabled: true
    estimate.magnetic_bias: true
"""
"""How the simulator installs its sensors; what is off by default is on."""

SIMULATED = {
    "every sensor": (
        ("second_gnss", "dual_antenna", "wheel", "magnetometer", "barometer", "body_velocity"),
        ("--outage", "60:20"),
        ("gnss_position", "gnss_velocity", "heading", "wheel", "mag", "baro", "body_velocity", "zupt", "zaru", "nhc"),
    ),
    "tight": (
        ("ranges", "magnetometer"),
        ("--mode", "tight", "--outage", "90:15"),
        ("pseudorange", "range_rate", "mag", "zupt", "zaru", "nhc"),
    ),
}
"""By name: sensors, further arguments of `eskf_replay`, and the aids that have to be fused: else the case shows nothing
of them."""

RESULTS = ("odometry.mcap", "trajectory.tum", "aids.csv")


def recordings(folder: Path) -> Iterator[tuple[str, list[str], Sequence[str]]]:
    """Name of each case, the arguments of `eskf_replay` for it, and the aids that have to be fused."""
    gnss = "gnss_position", "gnss_velocity"
    yield "bundled", [str(ROOT / "bags/tunnel_drive.mcap"), "--config", str(ROOT / "config/tunnel_drive.yaml")], gnss
    config = folder / "simulated.yaml"
    config.write_text(INSTALLATION, encoding="utf-8")
    for name, (sensors, options, aids) in SIMULATED.items():
        bag = folder / f"{name.replace(' ', '_')}.mcap"
        words = [word for sensor in sensors for word in ("--sensor", sensor)]
        if simulate(["drive", "--seed", "7", "--grade", "consumer", "--quiet", "--out", str(bag), *words]):
            sys.exit(2)
        yield name, [str(bag), "--config", str(config), *options], aids
    try:
        drive = kitti_recording(folder, True)
    except ImportError:
        print("digests: without gtsam there is no real drive (pip install gtsam)", file=sys.stderr)
        return
    yield "KITTI", [str(drive.bag), "--config", str(drive.config((), True)), "--outage", "100:20"], gnss


def digest(name: str, arguments: list[str], aids: Sequence[str], folder: Path) -> dict[str, str]:
    """Replay one case; return a digest of each result. Ends with 2 when an aid that belongs to it was never fused."""
    if replay([*arguments, "--output-rate", "0", "--out", str(folder), "--quiet"]):
        sys.exit(2)
    (results,) = folder.glob("*_eskf")
    found = {name: hashlib.sha256((results / name).read_bytes()).hexdigest()[:16] for name in RESULTS}
    summary = json.loads((results / "summary.json").read_text())
    if idle := [aid for aid in aids if not summary["aids"].get(aid, {}).get("fused")]:
        print(f"digests: {name}: never fused, so that nothing is shown of it: {', '.join(idle)}", file=sys.stderr)
        sys.exit(2)
    final = summary["final"]
    found["final"] = hashlib.sha256(json.dumps(final, sort_keys=True).encode()).hexdigest()[:16]
    return found


def main() -> int:
    """Print the digests; return 1 when one differs from those to compare with, 2 when a case cannot be run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--compare", type=Path, metavar="FILE", help="digests saved before")
    parser.add_argument("--save", type=Path, metavar="FILE", help="where to keep the digests")
    options = parser.parse_args()
    before = json.loads(options.compare.read_text()) if options.compare else None
    digests = {}
    with tempfile.TemporaryDirectory() as made:
        for number, (name, arguments, aids) in enumerate(recordings(Path(made))):
            digests[name] = digest(name, arguments, aids, Path(made) / f"results_{number}")
            print(name, *(f"{key}={value}" for key, value in digests[name].items()), flush=True)
    if options.save:
        options.save.write_text(json.dumps(digests, indent=2) + "\n")
    if before is None:
        return 0
    changed = sorted(name for name in before.keys() | digests.keys() if before.get(name) != digests.get(name))
    print("not the same: " + ", ".join(changed) if changed else "all the same")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
