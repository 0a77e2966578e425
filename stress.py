"""python stress.py bundle=hopper"""

from gns_pyg import cli

if __name__ == "__main__":
    cli.stress()
