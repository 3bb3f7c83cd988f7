"""``python -m eskf_ros.parameters``: write the files that are generated from the parameters."""

import sys

from eskf_ros.parameters.docs import main

sys.exit(main())
