"""The commands of `rack` and the libraries behind them."""
