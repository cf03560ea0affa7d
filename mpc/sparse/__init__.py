"""The tracking problem with states and poses as variables: larger than the condensed one, but sparse."""
