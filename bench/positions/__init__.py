"""Recovery of hidden positions of keypoints: from lines or permuted coordinates, and the neighbourhood of each keypoint."""
