"""`rlctl runs report`: what came of a training, or of one recipe with several seeds, as one file to read or to send."""
