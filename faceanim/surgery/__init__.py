"""Operations on the facial skeleton: bones cut and moved as a plan says, and the skin that follows."""
