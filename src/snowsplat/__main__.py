"""`python -m snowsplat`, the same as the command `snowsplat`."""

import sys

from snowsplat.cli.main import main

sys.exit(main())
