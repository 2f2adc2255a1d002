"""Where does it meet other software? Each bridge needs the packages of its own extra."""
