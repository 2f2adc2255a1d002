"""What can happen in one control period: the pursuer's motions, and the designs that outlast them."""
