"""`sdfsim identify`: parameters of a scene from recorded motions. Start reading at `optimiser`."""
