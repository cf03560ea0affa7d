"""What happens to a robot during a run: named, seeded scenarios and the plant that undergoes them."""
