"""Study of controllers on robots, surfaces and sensors that they were not tuned for."""
