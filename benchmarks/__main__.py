"""`python -m benchmarks`: everything that `make bench` measures."""

from benchmarks import closed_loop

closed_loop.main()
