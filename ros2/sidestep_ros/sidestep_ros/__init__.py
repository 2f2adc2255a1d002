"""ROS 2 nodes around `sidestep.robot`: they carry messages, and decide nothing themselves."""
