from gsgan.data.synthetic.character import Character
def with_anchors(character: Character) -> Character:
    return character
