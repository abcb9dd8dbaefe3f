"""The timing model of one rack: predicted from budgets, measured in a run."""
