"""The commands, as modules to run from a clone: `python -m src.train`.

They are those of `meshspiral.commands`. The library is imported as `meshspiral` only, from this
folder whether or not another version is installed: one copy of every class.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.modules[f"{__name__}.meshspiral"] = None  # `import src.meshspiral` is an error, not a copy
