"""python rollout.py bundle=runs/.../bundle trajectory=data/hopper/case_016.h5"""

from gns_pyg import cli

if __name__ == "__main__":
    cli.rollout()
