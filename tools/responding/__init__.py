"""The response of the whole system to an operator: predicted to the tick, measured, and shown beside its bounds."""
