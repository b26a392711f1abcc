"""The commands: arguments -> one call -> report. Heavy imports happen inside them."""
