"""Planning for an arm: inverse kinematics, collisions, paths. Equal questions get equal answers, in any process."""
