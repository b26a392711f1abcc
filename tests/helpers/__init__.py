"""What tests of several rooms share: no test is here."""
