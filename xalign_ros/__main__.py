"""`python -m xalign_ros` is the `xalign` command."""

import sys

from xalign_ros.apps.main import main

sys.exit(main())
