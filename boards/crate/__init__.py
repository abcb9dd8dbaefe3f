"""The Rack and its crate: launching boards, supervising them, ending them."""
