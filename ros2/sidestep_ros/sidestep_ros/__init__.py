"""ROS 2 nodes around `sidestep.bridges.onboard`: they carry messages, and decide nothing themselves."""
