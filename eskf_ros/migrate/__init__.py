"""`eskf_migrate`: the parameter files of robot_localization, navsat_transform and FusionCore as one of ours."""
