"""python evaluate.py bundle=runs/.../bundle"""

from gns_pyg import cli

if __name__ == "__main__":
    cli.evaluate()
