"""The experiment harness: plans, jobs, stored results, statistics and their report."""
