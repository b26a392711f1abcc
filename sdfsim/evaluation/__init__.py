"""How good and how expensive: models against recordings, error against time, the hard cases."""
