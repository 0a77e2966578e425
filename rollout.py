"""python rollout.py bundle=runs/.../bundle trajectory=data/hopper/case_016.h5"""

import hydra

from gns_pyg import run
from gns_pyg.config import CONF

if __name__ == "__main__":
    hydra.main(config_path=CONF, config_name="rollout", version_base="1.3")(run.entry(run.rollout))()
