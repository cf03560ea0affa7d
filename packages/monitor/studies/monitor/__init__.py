"""The monitor put to the test: controllers that are broken on purpose, hours of drives in which nothing is wrong."""
