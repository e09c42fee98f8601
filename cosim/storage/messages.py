"""Messages of files: archives, tables, YAML, results folders and the cache."""

from cosim.base.messages import Template

# -- archives -------------------------------------------------------------------------------------
BAD_IDENTIFIER = Template("E-STO-001", 'its modelIdentifier "{name}" is no name of a file')
NO_ZIP_ARCHIVE = Template("E-STO-002", "it is not a zip archive")
NO_MEMBER = Template("E-STO-003", "it has no {name}")
DAMAGED_ARCHIVE = Template("E-STO-004", "its archive is damaged: {reason}")
MANY_MEMBERS = Template("E-STO-005", "it holds more than {limit} files")
MEMBER_OUTSIDE = Template("E-STO-006", '"{name}" in it would be written outside its folder')
BACKSLASH_IN_MEMBER = Template("E-STO-007", '"{name}" in it has a backslash; separate folders by /')
LINK_AS_MEMBER = Template("E-STO-008", '"{name}" in it is a link; pack the file it leads to')
ENCRYPTED_MEMBER = Template("E-STO-009", '"{name}" in it is encrypted; pack it without a password')
UNKNOWN_COMPRESSION = Template("E-STO-010", '"{name}" in it is compressed by an unsupported method; use deflate')
LARGE_ARCHIVE = Template(
    "E-STO-011", "it would unpack to {size:.0f} MB, more than the {limit:.0f} MB that are unpacked{hint}"
)
SHARED_BYTES = Template("E-STO-012", '"{first}" and "{second}" in it share bytes: a zip bomb?')
LARGE_MEMBER = Template("E-STO-013", "its {name} has {size:.0f} MB, more than the {limit:.0f} MB that are read")
DOCTYPE = Template("E-STO-014", "its {name} has a DOCTYPE, which {standard} knows nothing of; take it out")
DEEP_XML = Template("E-STO-015", "its {name} is nested too deep; at most {limit} levels are read")
LARGE_XML = Template(
    "E-STO-016", "its {name} has more than the {elements} elements with {attributes} attributes each that are read"
)
BAD_XML = Template("E-STO-017", "its {name} is not XML (line {line}): {reason}")
UNKNOWN_ENCODING = Template("E-STO-018", "its {name} is in an unknown encoding; write it in UTF-8")

# -- cache ----------------------------------------------------------------------------------------
UNTRUSTED_CACHE = Template("N-STO-019", "the cache {folder} is not used, a temporary one takes its place: {reason}")

# -- files ----------------------------------------------------------------------------------------
NO_FILE = Template("E-STO-020", "is no file")
NO_SUCH_FILE = Template("E-STO-021", "no such file")
UNREADABLE_FILE = Template("E-STO-022", "cannot be read: {reason}")
MISSING_FILE = Template("E-STO-023", "no such file; give {wanted}")
EMPTY_FILE = Template("E-STO-024", "is empty; give {wanted}")
MISSING_OR_UNREADABLE_FILE = Template("E-STO-025", "no such file, or none that can be read; give {wanted}")
OTHER_KIND = Template("E-STO-026", "is {kind}, not {wanted}: {step}")
FOLDER_FOR_FILE = Template("E-STO-027", "is a folder, not {wanted}; in it: {files}")
LOCALE_WITHOUT_NAME = Template(
    "E-STO-028", "cannot be read in the locale of this shell; set PYTHONUTF8=1, or LC_ALL=C.UTF-8"
)
NO_UTF8_NAME = Template("E-STO-029", "is not UTF-8 text; give the file or folder another name")

# -- tables ---------------------------------------------------------------------------------------

# -- YAML and JSON --------------------------------------------------------------------------------
NO_UTF8_FILE = Template("E-STO-063", "is not UTF-8 text; save it as UTF-8")
LARGE_FILE = Template("E-STO-064", "has {size:.0f} MB, more than the {limit:.0f} MB that are read; make it shorter")
LARGE_YAML = Template(
    "E-STO-065",
    "has {size:.1f} MB of YAML, of which at most {limit:g} MB and about {keys} keys and values are read;"
    " write it as JSON, which may have {json_limit:g} MB, or make it shorter",
)
NOT_YAML = Template("E-STO-066", "is not YAML: {problem}")
NO_MAPPING = Template("E-STO-067", "is not a mapping of keys to values")
DEEP_FILE = Template("E-STO-068", "is nested too deep; at most {limit} levels are read")
MANY_PARTS = Template(
    "E-STO-069", "has more than {limit} values when its aliases are expanded; use fewer values or aliases"
)
CIRCULAR_MERGE = Template("E-STO-070", "merges itself; take the merge out")
KEY_WITHOUT_TEXT = Template("E-STO-071", "a key is text, no list and no mapping")
MERGE_WITHOUT_MAPPING = Template("E-STO-072", "only a mapping, or a list of mappings, can be merged")
DUPLICATE_KEY = Template("E-STO-073", 'duplicate key "{key}"; keep one')
BAD_NUMBER = Template("E-STO-074", '"{text}" is no number')
UNKNOWN_TAG = Template("E-STO-075", 'the tag "{tag}" means nothing here; leave it out')
HALF_CHARACTER = Template(
    "E-STO-076", "contains half a character (one half of a surrogate pair); write the whole character"
)
MANY_FAULTS = Template("E-STO-077", "{count} faults in all; the first {limit} are shown")
UNKNOWN_KEY = Template("E-STO-078", 'unknown key "{key}"{hint} (known here: {keys})')
MISSING_KEY = Template("E-STO-079", '"{name}" is missing; add it')
WRONG_VALUE = Template("E-STO-080", "{name} is {value}: {reason}")

# -- results folders ------------------------------------------------------------------------------
BLANK_FOLDER = Template("E-STO-081", "is blank; {cure}")
FILE_IN_PLACE_OF_FOLDER = Template(
    "E-STO-082", "cannot be the folder for results: {file} is a file; give a folder as --out"
)
IMPOSSIBLE_FOLDER = Template("E-STO-083", "cannot be the folder for results: {reason}; give another folder as --out")
FOLDER_IN_PLACE_OF_FILE = Template(
    "E-STO-084", "is a folder; a file is to be written there; give another folder as --out"
)
FILE_OF_OTHER_USER = Template(
    "E-STO-085", "belongs to another user, and only its owner may replace it; give another folder as --out"
)
INPUT_IN_FOLDER = Template("E-STO-086", "is read, and results would be written over it; give another folder as --out")
READ_ONLY_FOLDER = Template("E-STO-087", "cannot be written; give another folder as --out")
BUSY_FOLDER = Template(
    "E-STO-088", "another command writes into this folder now; wait for its end, or give another folder as --out"
)
FOLDER_OF_OTHER_SCENARIO = Template(
    "E-STO-089",
    'holds the run of another scenario, "{name}"; give another folder as --out, or move it to runs by --force',
)
FOLDER_OF_OTHER_COMMAND = Template(
    "E-STO-090", "contains results of `{command}`; give another folder with --out, or move them to runs with --force"
)
FOLDER_OF_OTHER_SOURCES = Template(
    "E-STO-091",
    "contains results of `{command}` from {sources}; give another folder with --out, or move them to runs with --force",
)
FILE_FOR_EARLIER_RUNS = Template(
    "E-STO-092",
    "is a file; earlier runs are kept in a folder of this name; move it away, or give another folder as --out",
)
READ_ONLY_EARLIER_RUNS = Template(
    "E-STO-093",
    "cannot be written, or is on another disk; earlier runs are kept there;"
    " move it away, or give another folder as --out",
)
LINK_IN_FOLDER = Template(
    "E-STO-094", "is a link, so files would be moved or written elsewhere; remove it, or give another folder as --out"
)
LINK_OF_OTHER_USER = Template("E-STO-095", "is a link of another user; give another folder as --out")
OPEN_MOVE = Template("E-STO-096", "is open to other users, or not yours; move it away")
DAMAGED_LIST = Template("E-STO-097", "is damaged; move {folder} away")
NAME_OUTSIDE = Template("E-STO-098", "names {name}, outside {results} or no result; move {folder} away")
LINK_IN_EARLIER_RUNS = Template("E-STO-099", "is a link, and earlier runs hold none; move {folder} away")
LARGE_MAT = Template(
    "E-STO-104", "{rows} rows of {columns} columns are more than the 2 GB of a MAT variable; take another format"
)
MAT_73 = Template("E-STO-101", "is a MAT file of version 7.3; write it with -v7, or as HDF5 with one dataset a signal")
OCTAVE_FORMAT = Template(
    "E-STO-105", "is a file in a format of Octave's own; write it as save('-v7', 'NAME.mat', 'time', …)"
)
BAD_TABLE = Template("E-STO-102", "is no {format} file that can be read: {reason}; write it again")
DAMAGED_MANIFEST = Template(
    "W-STO-106", "{file} is damaged: units, texts, inputs and criteria of its run are not known; run it again"
)
LATER_RECORD = Template(
    "W-STO-107",
    "{file} has the schema version {found}, written by cosim {by}; {known} is known here: keys that are new or changed "
    "are not read, use that version of cosim",
)
OTHER_VERSION = Template("N-STO-108", "{file} was written by cosim {found}, and this is {own}")
GONE = Template("E-STO-111", "was removed while it was read; repeat the command with the results that are left")
NO_VERSION = Template(
    "W-STO-112", "{file} is a manifest without schema_version, as after an edit; it is read as one of version {known}"
)
WRONG_TYPE = Template(
    "W-STO-113", "{file}: {field} is {value}, not {wanted}; {key} is not used: run it again, or correct the file"
)
