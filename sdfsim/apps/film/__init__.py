"""Films of a fixed camera: where the bodies of a scene were in them. Start reading at `track`."""
