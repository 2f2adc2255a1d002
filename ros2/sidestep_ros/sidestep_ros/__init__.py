"""ROS 2 nodes around `sidestep.robot`. They only transport messages; the decision core decides."""
