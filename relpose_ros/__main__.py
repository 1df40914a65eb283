"""``python -m relpose_ros``: the command line."""

from relpose_ros.cli import main

raise SystemExit(main())
