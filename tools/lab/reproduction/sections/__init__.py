"""The claims of the paper, a file for each of its sections or for a few of them."""
