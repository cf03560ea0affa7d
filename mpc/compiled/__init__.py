"""The C sources of `mpc/native` at work in Python: their constants, their compilation, and the parts built on them."""
