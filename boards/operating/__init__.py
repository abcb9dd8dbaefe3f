"""Commands of an operator: asked for in a config, by `Rack.command` or `rack command`, and given by the clock."""
