"""Pictures of the robot in MuJoCo: a model of its looks alone, apart from the physics."""
