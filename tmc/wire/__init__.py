"""The radio: messages, their codec, and the sockets that carry them."""
