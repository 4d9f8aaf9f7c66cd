
-- -------------------------------------------------------------------------------------------------- values

local function hex(bytes, separator)
  return (bytes:gsub(".", function(c)
    return string.format("%02x", c:byte()) .. (separator or "")
  end):gsub(" $", ""))
end

-- Reads a number at AT; returns it as unsigned 32 bits and where it ends, or nothing when it is cut short.
local function read_number(content, at)
  local group = content:byte(at)
  if not group then
    return nil
  end
  local value = group % 0x80
  if value >= 0x60 then
    value = value - 0x80
  end
  local first = at
  at = at + 1
  while group >= 0x80 do
    group = content:byte(at)
    if not group or at - first >= 5 then
      return nil
    end
    value = value * 0x80 + group % 0x80
    at = at + 1
  end
  return value % 0x100000000, at
end

local function clipped(code, value)
  local width = D.widths[code]
  value = value % 2 ^ width
  if D.signed[code] and value >= 2 ^ (width - 1) then
    value = value - 2 ^ width
  end
  return value
end

local function whole(value)
  return string.format("%d", value)
end

-- Reads parameters with CODES at AT; returns the values and where they end, or nothing.
local function read_values(codes, content, at)
  local values = {}
  for i, code in ipairs(codes) do
    local number
    number, at = read_number(content, at)
    if not number then
      return nil
    end
    if D.widths[code] then
      values[i] = clipped(code, number)
    else
      if number > #content - at + 1 then
        return nil
      end
      values[i] = content:sub(at, at + number - 1)
      at = at + number
    end
  end
  return values, at
end

local function printable(text)
  if text:find("^[\32-\126]*$") then
    return text
  end
  return "'" .. text:gsub("[^\32-\126]", function(c)
    return string.format("\\x%02x", c:byte())
  end) .. "'"
end

-- The text of debug outputs is a printf format.
local function output_text(format, values)
  local i = 0
  local text = format.text:gsub("%%(%.?%*?h?[%%suic])", function(code)
    if code == "%" then
      return "%"
    end
    i = i + 1
    return type(values[i]) == "number" and whole(values[i]) or values[i]
  end)
  return format.name .. " " .. printable(text)
end

local function message_text(dictionary, format, values)
  if format.text then
    return output_text(format, values)
  end
  local words = { format.name }
  for i, value in ipairs(values) do
    local shown
    if type(value) == "string" then
      shown = hex(value)
    else
      local names = dictionary.enumerations[format.enumerations[i]]
      shown = names and names[value] or whole(value)
    end
    words[#words + 1] = format.names[i] .. "=" .. shown
  end
  return table.concat(words, " ")
end

local function dictionary_of(nodeid)
  return D.dictionaries[nodeid] or D.dictionaries.any
end

local function format_at(formats, content, at)
  local id
  id, at = read_number(content, at)
  if not id then
    return nil
  end
  return formats[id < 0x80000000 and id or id - 0x100000000], at
end

