"""Simulated recordings with truth: ``eskf_simulate`` and the API behind it (`eskf_ros.simulate.scenario.simulate`)."""
