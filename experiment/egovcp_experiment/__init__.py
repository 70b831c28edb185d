"""The paper's experiments: cells that are run once, and the reports made of their results."""
