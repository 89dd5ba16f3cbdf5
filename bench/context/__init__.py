"""The context model of the attack `context`: it weights the words of a set by the sets of nearby keypoints."""
