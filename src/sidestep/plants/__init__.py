"""In which physics? Robots on the ground and in the air, in a physics simulator."""
