from .class_meshes import MeshFile as MeshFile
from .class_meshes import class_meshes as class_meshes
from .recorded import RecordedFrames as RecordedFrames
