"""The mutation check: `python -m tests.defects [PART OF A NAME]` applies every deliberate defect, or those so named,
and writes what caught each to docs/defects.json."""

import json
import sys

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
    part, missed = " ".join(sys.argv[1:]), 0
    found = json.loads(RESULT.read_text())["defects"] if RESULT.exists() else {}
    for defect, caught_by in campaign([defect for defect in DEFECTS if part in defect.name]):
        print(f"{defect.name:<58} {defect.file:<36} {caught_by or 'NOT CAUGHT'}", flush=True)
        missed += caught_by is None
        found[defect.name] = {"file": defect.file, "caught_by": caught_by}
        table = {each.name: found[each.name] for each in DEFECTS if each.name in found}
        caught = sum(each["caught_by"] is not None for each in table.values())
        RESULT.write_text(json.dumps({"caught": caught, "defects": table}, indent=2) + "\n")
    sys.exit(bool(missed))
