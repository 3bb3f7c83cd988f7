"""A recording through the filter: here the one that comes with this package, in practice your own."""

from __future__ import annotations

from pathlib import Path

import eskf_ros

CHECKOUT = Path(__file__).resolve().parent.parent


def main() -> eskf_ros.Result:
    """Run the filter over the recording and print what it found."""
    parameters = eskf_ros.load_parameters(CHECKOUT / "config" / "tunnel_drive.yaml")
    tables = eskf_ros.read_bag(CHECKOUT / "bags" / "tunnel_drive.mcap", parameters)
    result = eskf_ros.run(**tables, parameters=parameters, output_rate=10.0)
    for name, counts in result.summary["aids"].items():
        print(f"{name}: {counts['fused']} of {counts['offered']} fused, mean NIS {counts['nis_mean'] or 0.0:.2f}")
    for warning in result.warnings:
        print(warning)
    return result


if __name__ == "__main__":
    main()
