"""The study of controllers on robots, floors and sensors that they were not tuned for."""
