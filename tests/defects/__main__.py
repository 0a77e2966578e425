"""The mutation check: `python -m tests.defects [PART OF A NAME]` applies every deliberate defect and writes
docs/defects.json (all of them only)."""

import json
import sys
import time

# imported before the forks, so that each starts with them; nothing of the project is, nor any plugin of pytest's
import h5py  # noqa: F401
import pytorch_lightning  # noqa: F401
import scipy.spatial  # noqa: F401
import torch
import torch_geometric.nn  # noqa: F401
import trimesh  # noqa: F401

from tests.defects.campaign import campaign
from tests.defects.catalogue import DEFECTS, ROOT

RESULT = ROOT / "docs" / "defects.json"

if __name__ == "__main__":
    torch.set_num_threads(1)
    part = " ".join(sys.argv[1:])
    chosen = [defect for defect in DEFECTS if part in defect.name]
    began = time.monotonic()
    found = campaign(chosen)
    missed = [name for name, each in found.items() if each["caught_by"] is None]
    print(f"{len(found) - len(missed)} of {len(found)} caught, {time.monotonic() - began:.0f} s", *missed, sep="\n")
    if not part:
        RESULT.write_text(json.dumps({"caught": len(found) - len(missed), "defects": found}, indent=2) + "\n")
    sys.exit(bool(missed))
