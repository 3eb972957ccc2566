"""A hand that is not there: physics of its own, scenarios with ground truth, nodes on a bus."""
