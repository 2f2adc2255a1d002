"""Interfaces to other software. Each bridge needs the packages of its extra."""
