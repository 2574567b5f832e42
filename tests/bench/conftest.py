"""The benchmark scripts can be imported."""

import sys

from commands import ROOT

sys.path.insert(0, str(ROOT / "scripts" / "bench"))
