"""The context model: weighs the words of a set by the sets of nearby keypoints. Used by the attack `context`."""
