"""python train.py experiment=hopper"""

import hydra

from gns_pyg import run
from gns_pyg.config import CONF

if __name__ == "__main__":
    hydra.main(config_path=CONF, config_name="train", version_base="1.3")(run.entry(run.train))()
