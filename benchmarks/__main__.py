"""`python -m benchmarks`: everything that `make bench` measures."""

from benchmarks import closed_loop, ekf2, svgs_camera

closed_loop.main()
ekf2.main()
svgs_camera.main()
