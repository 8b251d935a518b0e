"""Reading a compiled model: its parts, rigid links, poses, rotations and shapes."""
