"""Runnable studies: `python -m experiments.NAME`."""

import sys
from importlib.util import find_spec

NEEDED = ("matplotlib", "platformdirs", "rich", "scipy", "sklearn", "threadpoolctl", "tqdm")
_missing = [name for name in NEEDED if find_spec(name) is None]
if _missing:
    _line = f"the experiments need {', '.join(_missing)}: pip install 'torch-ebip[experiments]'"
    # As a command, which is what `-m` stands here for while its package is imported, without a traceback.
    raise SystemExit(_line) if sys.argv[:1] == ["-m"] else ImportError(_line)
