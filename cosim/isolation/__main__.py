"""A worker process; whoever starts one reads on in `cosim/isolation/worker.py`."""

from cosim.isolation.worker import main

main()
