"""Labels on the map: label images fused per voxel and per surfel with counts, the things they make up, and queries."""
