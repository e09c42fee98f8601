"""Entry point of a worker process; see `cosim/isolation/worker.py`."""

from cosim.isolation.worker import main

main()
