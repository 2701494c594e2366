#!/usr/bin/env bash
# Renders a gallery and writes FOLDER/index.html, which shows each picture with the command that makes it.
# usage: deploy/gallery.sh [FOLDER]    (default: out/gallery; some minutes on two cores)
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1:-out/gallery}
deploy/build.sh release >&2
mkdir -p "$folder"

index=$folder/index.html
cat >"$index" <<'HTML'
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Tessera: gallery</title>
<style>
  body { margin: 2rem auto; max-width: 60rem; padding: 0 1rem; font: 1rem/1.5 sans-serif; background: #161616; color: #ddd; }
  img { display: block; width: 100%; }
  code { display: block; overflow-x: auto; white-space: nowrap; color: #9cf; }
  figure { margin: 0 0 3rem; }
</style>
<h1>Tessera</h1>
HTML

# picture NAME CAPTION ARGUMENTS: renders folder/NAME.jpg by `tessera render ARGUMENTS`.
picture() {
    local name=$1 caption=$2
    shift 2
    echo "$name: tessera render $*" >&2
    build/bin/tessera render "$@" -o "$folder/$name.jpg"
    printf '<figure><img src="%s.jpg" alt=""><figcaption>%s<code>tessera render %s -o %s.jpg</code></figcaption></figure>\n' \
        "$name" "$caption" "$*" "$name" >>"$index"
}

picture cornell "Cornell's box: one lamp, and colour that bleeds from wall to wall." cornell --size 720x720 --passes 4
picture office "An office by evening: lamps, gloss, mirrors, glass." office --size 960x540 --passes 6
picture rooms "A hundred lamps in ten rooms, most of them hidden from any one place." rooms --size 960x540 --passes 4
picture building "A million triangles and thousands of lamps." building --size 960x540 --passes 4
picture museum "Triangles that fly apart." museum --size 960x540 --passes 4
picture kitchen "A kitchen: mirrors, and six lamps that no ray can hit." kitchen --size 960x540 --passes 4
picture shading "Wood, marble and brick, computed where rays hit." shading --size 960x540 --passes 4
picture terrain "661 trees." terrain --size 960x540 --passes 4
picture robots "Robots on their way." robots --size 960x540 --passes 4
picture foliage "Leaves: nothing smooth for a filter to work with." foliage --size 960x540 --passes 4
picture sunflowers "28,000 instances, a billion triangles." sunflowers --size 960x540 --passes 4
echo "$index"
