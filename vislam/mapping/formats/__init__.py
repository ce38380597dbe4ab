"""Files of clouds and meshes: PLY, PCD, glTF and OBJ."""
