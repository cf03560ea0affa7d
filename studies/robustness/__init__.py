"""The study of controllers on robots, floors and sensors that nobody tuned them to."""
