"""Dense maps from keyframe poses: clouds, an occupancy octree, a navigation grid, a mesh and pictures of them."""
