"""What is fast, how fast, and at what accuracy: each module says what it measures. They keep memory as commands do."""

from gns_pyg.machine import keep_memory

keep_memory()
