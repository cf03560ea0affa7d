"""Parameter files for Nav2, ros2_control and robot_localization from an identified robot."""
