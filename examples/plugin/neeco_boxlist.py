"""Box list: a data set writer, format `boxlist`; a line per instrument and image: file, name, left, top, size (px)."""

from neeco.base.files import write_text
from neeco.synthesis.writers import Writer, WrittenImages


class BoxList(Writer):
    format = "boxlist"
    description = "`boxlist/boxes.csv`, a line per instrument and image"

    def write(self, images: WrittenImages) -> None:
        lines = ["image,instrument,left,top,width,height"]
        for record in images.records:
            for label in (label for label in record["labels"] if label["area"] > 0):
                lines.append(",".join(map(str, [record["image"], label["name"], *label["box"]])))
        write_text(images.root / self.format / "boxes.csv", "\n".join(lines) + "\n")
