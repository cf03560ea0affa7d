"""Study of controllers on robots, surfaces and sensors for which they were not tuned."""
