"""Tables for arrays in memory (`eskf_ros.api`): input columns, results, and recordings as tables."""
